"""Commands of the command line. Floor 16."""
