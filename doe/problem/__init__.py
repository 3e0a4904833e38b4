"""The design problem: limits, constraints, candidates, what is known beforehand."""
