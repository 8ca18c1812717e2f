"""The paper's comparison on held-out plants, with ablations, on both cars."""
