"""The library as a prior over effects that are not named."""
