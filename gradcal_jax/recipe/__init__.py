"""What is executed: recipe, tracks, rounding, and how devices speak."""
