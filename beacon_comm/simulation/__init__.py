"""Simulated event streams: whole scenes with their truth, one LED's blob, and stresses for recorded signals.

Whole scenes, by the physics of LED, lens, pixel and readout (``docs/simulator.md``)::

    from beacon_comm.simulation.description import make_description
    from beacon_comm.simulation.scene import simulate

    description = make_description({
        'duration_s': 2.0,
        'beacons': [{'bit_rate_bps': 1000, 'path': {'kind': 'line', 'from_px': [100, 200], 'speed_px_per_s': 800}}],
    })                                           # the keys of a scene file: docs/scenes_format.md
    batches, truth = simulate(description, seed=1)
    for batch in batches:                        # EventBatch every 10 ms (piece_s), simulated as they are asked for
        receiver.push(batch)
    x_px, y_px = truth.beacons[0].centre(t_ns)   # SceneTruth, BeaconTruth: beacon_comm.simulation.truth

``read_description(path)`` reads a scene file.  One LED without pixels: ``led``; stresses for any signal: ``stress``.
"""
