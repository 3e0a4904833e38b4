"""Upper bounds on every criterion, and the proofs behind them. Nothing here imports a solver."""
