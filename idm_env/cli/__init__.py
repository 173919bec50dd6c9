"""The command line: commands, what they refuse before anything slow is imported, and what works on this machine."""
