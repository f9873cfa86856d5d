"""What every file is made of: problems, quantities, sections, documents."""
