"""The paper's tables, figures and equations, computed again."""
