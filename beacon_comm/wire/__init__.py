"""Bytes of event messages to event batches, and back."""
