"""What was recorded: logs, tables of others, and their faults."""
