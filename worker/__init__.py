"""Queued work: rollouts, replays, fine-tuning, evaluation, publishing, and the process tree.

Modules at this level import neither torch, mujoco nor viser: the parent of the worker pool forks
its children, and a parent that has used torch makes them hang. Job functions import them.
"""
