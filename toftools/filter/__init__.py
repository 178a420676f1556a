"""Steps around a correction, one per file: ``make(sensor, *, params) -> run``.

Before a correction ``run(Phasors) -> Phasors``, after it ``run(DepthMap, Phasors) -> DepthMap``,
the phasors being those that the correction saw. `toftools.chain` joins them.
"""
