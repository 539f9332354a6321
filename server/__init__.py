"""REST service and SQL store. Never imports torch, mujoco or viser."""
