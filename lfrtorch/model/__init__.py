"""An LFR with its scaling, rate and channels, and its states online."""
