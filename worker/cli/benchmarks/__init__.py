"""Benchmarks of the fine-tuners, one module a task."""
