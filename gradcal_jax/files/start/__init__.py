"""What a user begins with: answers to questions, made into files."""
