"""What is stated: sensor, rig, requirements, plan, and what a plan resolves to."""
