"""Denoisers, the policy around them (history, chunks, normaliser) and its file form."""
