"""The paper's figures, from the dictionary, simulation and stored sessions."""
