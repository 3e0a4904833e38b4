"""What is found in several sessions, and what only in one."""
