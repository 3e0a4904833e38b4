"""Plans: what they are, their files, rounding, order and spacing, and the accuracy they promise."""
