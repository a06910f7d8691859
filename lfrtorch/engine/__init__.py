"""One trajectory of a model and its derivatives."""
