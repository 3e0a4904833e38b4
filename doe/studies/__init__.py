"""Monte Carlo studies, comparisons of solvers, and the blind study of the diagnosis."""
