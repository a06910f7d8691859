"""Models on new data."""
