"""Parts of the benchmark; see experiments/benchmark.py."""
