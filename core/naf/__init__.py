"""NAF: a neural attenuation field fitted to projections (Zha, Zhang and Li 2022, arXiv 2209.14540)."""
