"""The exact plant as a process of its own: `python -m servotwin.drives.simulated PLANT.toml`, and its client."""
