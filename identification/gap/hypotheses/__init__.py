"""Each effect at each joint as a hypothesis: its columns, tests, and what a plan can detect."""
