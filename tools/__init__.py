"""Benchmarks, trials and checks of this repository: `python -m tools.bench.bench_flights` from its root."""
