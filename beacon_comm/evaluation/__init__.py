"""Evaluation: decoded characters against the truth that was sent.  No truth ever enters a decoder."""
