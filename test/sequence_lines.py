"""Likelihoods and signals for the tests of the sequence receiver's stages."""

import numpy as np

from beacon_comm.core.likelihood import CONTEXTS
from beacon_comm.simulation.led import simulate_levels

NS = 1_000_000_000
BEFORE = 12  # idle bits before a text: more than a frame can have


def likelihoods_of(bits, sure=20.0, unsure=(), unsure_by=2.0):
    """Return log p ``(n, CONTEXTS)`` under which every other bit is ``sure`` (nat) less likely than the one given.

    The bits at the indices ``unsure`` are only ``unsure_by`` more likely than the other.
    """
    bits = np.asarray(bits, np.int64)
    price = np.full(len(bits), sure)
    price[list(unsure)] = unsure_by
    wrong = (np.arange(CONTEXTS) & 1)[None, :] != bits[:, None]
    return np.where(wrong, -price[:, None], 0.0)


def idle(count):
    """Return so many bits of idle line."""
    return np.ones(count, np.uint8)


def line_of_parts(*parts):
    """Return bits joined."""
    return np.concatenate([np.asarray(part, np.uint8) for part in parts])


def beacon_events(bits, bit_rate_bps, t0_ns=0, lead_s=0.05, tail_s=0.05, **options):
    """Return the simulated events of an LED that sends ``bits`` from ``t0_ns`` (ns) on, and idles around them."""
    levels = np.concatenate(([1], np.asarray(bits, np.int64), [1]))
    changes = np.flatnonzero(np.diff(levels))
    changes_ns = t0_ns + np.rint(changes * (NS / bit_rate_bps)).astype(np.int64)
    end_ns = t0_ns + round((len(bits) / bit_rate_bps + tail_s) * NS)
    return simulate_levels(
        changes_ns, levels[changes + 1].astype(np.uint8), t0_ns - round(lead_s * NS), end_ns, **options
    )
