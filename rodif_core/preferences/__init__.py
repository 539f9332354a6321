"""What people compared: choosing pairs, simulated corruption, and the noise in labels.

Nothing here imports torch or mujoco: the server and the simulated annotators use it too.
"""
