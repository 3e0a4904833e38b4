"""Designs that distinguish rival models: before any data, and after an ambiguous diagnosis."""
