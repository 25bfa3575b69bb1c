"""What accuracy costs in time: every knob alone, and the presets, on one capture."""
