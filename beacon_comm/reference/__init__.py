"""From bytes to tracks in plain numpy, stage by stage: what the compiled stages must equal, event for event."""
