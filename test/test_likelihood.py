"""Histograms of event counts, their back-off, and what they make of a bit."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beacon_comm.core.likelihood import (
    BACK_OFF,
    COMPRESSION,
    CONTEXTS,
    COUNTS,
    FLOOR,
    LEVELS,
    MEMORY_BITS,
    learn,
    logarithms,
    weigh,
)

ALL = slice(None)


def learnt(seed, bits, contexts=range(CONTEXTS)):
    """Return histograms of so many random bits in some of the contexts."""
    random = np.random.default_rng(seed)
    histograms = np.zeros((CONTEXTS, COUNTS, LEVELS))
    for context in random.choice(list(contexts), bits):
        counts = np.minimum(random.poisson(2.0 + 3.0 * context, COUNTS), LEVELS - 1)
        learn(histograms, counts.astype(np.uint8), context, 1.0)
    return histograms


def tables_of(histograms):
    tables = np.empty_like(histograms)
    logarithms(histograms, tables)
    return tables


# --- compression --------------------------------------------------------------------------------------------------


def test_compression_is_exact_for_few_and_as_the_root_for_many():
    table = COMPRESSION
    assert table.dtype == np.uint8 and table[:4].tolist() == [0, 1, 2, 3]
    n = np.arange(4, len(table))
    assert table[4:].tolist() == np.minimum(np.floor(2.0 * np.sqrt(n)), LEVELS - 1).tolist()
    assert (np.diff(table.astype(int)) >= 0).all() and table.max() == LEVELS - 1


# --- learning -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize('level', [0, 1, 17, LEVELS - 1])
def test_a_bit_is_learnt_with_a_little_of_its_neighbours(level):
    histograms = np.zeros((CONTEXTS, COUNTS, LEVELS))
    learn(histograms, np.full(COUNTS, level, np.uint8), 5, 2.0)
    expected = np.zeros(LEVELS)
    for at, share in ((level, 0.5), (max(level - 1, 0), 0.25), (min(level + 1, LEVELS - 1), 0.25)):
        expected[at] += 2.0 * share
    assert np.array_equal(histograms[5], np.tile(expected, (COUNTS, 1)))
    assert not histograms[[context for context in range(CONTEXTS) if context != 5]].any()


def test_each_count_is_learnt_in_its_own_histogram():
    histograms = np.zeros((CONTEXTS, COUNTS, LEVELS))
    learn(histograms, np.arange(3, 3 + COUNTS, dtype=np.uint8), 2, 1.0)
    assert histograms[2].argmax(axis=1).tolist() == list(range(3, 3 + COUNTS))
    assert histograms.sum() == COUNTS


# --- tables -------------------------------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 300),
    st.lists(st.integers(0, CONTEXTS - 1), min_size=1, max_size=CONTEXTS),
    st.floats(1e-3, 10.0),
)
def test_tables_are_normalised_and_nothing_is_impossible(seed, bits, contexts, weight):
    tables = tables_of(weight * learnt(seed, bits, contexts))
    assert np.exp(tables).sum(axis=2) == pytest.approx(1.0, abs=1e-5)
    assert np.exp(tables).min() >= FLOOR / LEVELS * (1.0 - 1e-9)


def expected_tables(histograms):
    """Return the tables written from their description, without sharing anything between the contexts."""
    tables = np.empty_like(histograms)
    even = np.full((COUNTS, LEVELS), 1.0 / LEVELS)
    for context in range(CONTEXTS):
        of_all = histograms.sum(axis=0)
        share = (1.0 - FLOOR) * of_all / of_all.sum(axis=1, keepdims=True) + FLOOR * even
        for bits in range(1, MEMORY_BITS + 1):
            alike = [c for c in range(CONTEXTS) if (c ^ context) & ((1 << bits) - 1) == 0]
            own = histograms[alike].sum(axis=0)
            share = (own + BACK_OFF * share) / (own.sum(axis=1, keepdims=True) + BACK_OFF)
        tables[context] = np.log((1.0 - FLOOR) * share + FLOOR * even)
    return tables


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 300), st.sampled_from([(0,), (1, 6), (2, 3, 7), tuple(range(8))]))
def test_back_off(seed, bits, contexts):
    histograms = learnt(seed, bits, contexts)
    assert tables_of(histograms) == pytest.approx(expected_tables(histograms), abs=1e-6)


def test_contexts_that_were_never_seen_are_taken_for_the_shorter_one():
    # Seen: ...000 and ...111 only.  Of the others, those that end in the same 2 bits cannot differ.
    tables = tables_of(learnt(1, 200, (0, 7)))
    for ending in range(4):
        never = [context for context in (ending, ending | 4) if context not in (0, 7)]
        for context in never[1:]:
            assert np.array_equal(tables[context], tables[never[0]])
    # ...100 was not seen: it leans on ...000, that ends alike; ...101 on ...111.
    assert np.abs(tables[4] - tables[0]).max() < np.abs(tables[4] - tables[7]).max()
    assert np.abs(tables[5] - tables[7]).max() < np.abs(tables[5] - tables[0]).max()


def test_a_context_that_is_seen_often_stands_on_its_own():
    histograms = learnt(2, 50, (1,))
    counts = np.full(COUNTS, 20, np.uint8)
    shares = []
    for _ in range(4):
        for _ in range(50):
            learn(histograms, counts, 5, 1.0)
        shares.append(np.exp(tables_of(histograms)[5, :, 20]).min())
    assert shares == sorted(shares) and 0.35 < shares[0] < shares[-1] < 0.5


def test_what_fades_leans_on_the_shorter_context_again():
    histograms = learnt(3, 400)
    differences = []
    for _ in range(4):
        tables = tables_of(histograms)
        differences.append(float(np.abs(tables[0b001] - tables[0b101]).mean()))
        histograms[[0b001, 0b101]] *= 0.1
    assert differences == sorted(differences, reverse=True) and differences[-1] < 0.2 * differences[0]


# --- likelihoods --------------------------------------------------------------------------------------------------


def test_likelihood_is_the_sum_over_the_counts():
    tables = tables_of(learnt(4, 300))
    counts = np.array([0, 1, 5, 31, 7, 2, 0, 12], np.uint8)
    likelihoods = np.empty(CONTEXTS)
    weigh(tables, counts, likelihoods)
    assert likelihoods == pytest.approx(tables[ALL, np.arange(COUNTS), counts].sum(axis=1))


def test_the_context_that_was_learnt_is_the_likely_one():
    random = np.random.default_rng(5)
    tables = tables_of(learnt(5, 2000))
    right = 0
    for context in range(CONTEXTS):
        for _ in range(50):
            counts = np.minimum(random.poisson(2.0 + 3.0 * context, COUNTS), LEVELS - 1).astype(np.uint8)
            likelihoods = np.empty(CONTEXTS)
            weigh(tables, counts, likelihoods)
            right += int(likelihoods.argmax()) == context
    assert right > 280  # of 400; guessing: 50
