"""The command line: its configuration by Hydra, the folder of a run, a module for each command."""
