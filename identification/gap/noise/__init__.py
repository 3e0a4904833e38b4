"""The noise: its size, what it depends on, what repeats say, and misfit that no effect explains."""
