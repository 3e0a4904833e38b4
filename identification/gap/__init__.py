"""The gap workflow behind `diagnose`: which physical effect is missing from the model?"""
