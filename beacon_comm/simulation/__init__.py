"""Simulated event streams of one LED: beacons, lamps and noise, for tests and the demo."""
