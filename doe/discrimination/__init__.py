"""Designs that tell rival models apart: before any data, and after an ambiguous diagnosis."""
