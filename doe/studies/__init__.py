"""Monte Carlo studies, comparisons of solvers, the blind study of the diagnosis, and the paper reproduced."""
