"""The paper's Figs. 1B–G, 2A–J and 3A–H, each panel with the data behind it."""
