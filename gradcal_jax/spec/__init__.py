"""What is stated: sensor, rig, requirements, plan, what a plan resolves to, and the contract of a prediction."""
