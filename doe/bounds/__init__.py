"""Upper bounds, and the approximate design problem whose optimum is one. Solvers of exact designs are not used here."""
