"""The Stable-Baselines3 algorithms: a shell over ``sb3_ars.core``."""
