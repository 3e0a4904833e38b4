"""Error curves: a smooth function of a joint's angle where no name fits."""
