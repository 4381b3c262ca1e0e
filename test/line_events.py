"""Signals for the demodulator's tests: an ideal line as edges, and as events in a burst after every edge."""

import numpy as np

from beacon_comm.core.framing import CharacterFrame, transitions
from beacon_comm.core.high_pass import Edges


def line_edges(bits, bit_rate_bps, t0_ns=0):
    """Return the edges of a line that sends ``bits`` from ``t0_ns`` (ns) on."""
    t_ns, level = transitions(np.asarray(bits, np.uint8), bit_rate_bps, t0_ns)
    return Edges(t_ns, level == 1)


def line_events(bits, bit_rate_bps, t0_ns=0, burst=20, width_bits=0.05):
    """Return times (ns) and polarities of ``burst`` events within ``width_bits`` after every edge."""
    t_ns, level = transitions(np.asarray(bits, np.uint8), bit_rate_bps, t0_ns)
    delay_ns = np.arange(burst) * (width_bits * 1e9 / bit_rate_bps / burst)
    times = (t_ns[:, None] + delay_ns.astype(np.int64)).ravel()
    return times, np.repeat(np.where(level == 1, 1, -1), burst).astype(np.int8)


def text_bits(text, frame=None, gap_bits=0):
    """Return the bits of a text, with so many idle bits after each character."""
    frame = frame or CharacterFrame()
    bits = frame.encode_bits(text).reshape(-1, frame.length)
    return np.hstack([bits, np.ones((len(bits), gap_bits), np.uint8)]).ravel()


def text_of(characters):
    """Return the codes of characters as text."""
    return ''.join(chr(character.code) for character in characters)


def in_batches(demodulator, t_ns, polarity, t_end_ns, cuts):
    """Push the events cut at ``cuts`` (ns), flush, and return all characters."""
    characters = []
    start = 0
    for cut in sorted(c for c in cuts if c < t_end_ns):
        # Events at the cut itself may come before or after it: both are legal.
        stop = max(start, int(np.searchsorted(t_ns, cut, side='right' if cut % 2 else 'left')))
        characters += demodulator.push(t_ns[start:stop], polarity[start:stop], int(cut))
        start = stop
    characters += demodulator.push(t_ns[start:], polarity[start:], int(t_end_ns))
    return characters + demodulator.flush()
