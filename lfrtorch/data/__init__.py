"""Records by use, and their scores."""
