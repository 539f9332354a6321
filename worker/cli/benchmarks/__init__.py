"""Benchmarks: of the fine-tuners, one module a task, and of rollouts."""
