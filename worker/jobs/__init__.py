"""One module a kind of job, each with `run(attempt)`. They import torch, mujoco and viser."""
