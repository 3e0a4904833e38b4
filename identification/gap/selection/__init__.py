"""Which effects are named: search, selection, rounds, and how certain a name is."""
