"""Scripted experts that make demonstrations, one module a task."""
