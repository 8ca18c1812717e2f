"""The paper's comparison over plants that nothing was tuned on, with ablations, on both cars."""
