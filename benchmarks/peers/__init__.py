"""What `benchmarks/transport.py` runs: one file per engine, and the process around an engine."""
