"""Rows whitened, and fits of models to them."""
