"""Survey of data before a fit."""
