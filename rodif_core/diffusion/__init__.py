"""Noise schedule and denoising chains: one mean and one standard deviation for all uses."""
