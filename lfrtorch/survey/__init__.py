"""What data look like before a fit."""
