"""What the command line needs beyond the settings: how a run is interrupted."""
