"""How probable each explanation is, and how far a choice is to be trusted."""
