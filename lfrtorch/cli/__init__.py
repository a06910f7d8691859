"""The command line: Hydra lives here alone."""
