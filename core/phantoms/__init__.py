"""Synthetic paired captures with known truth: photos and X-ray projections of objects made of signed distances."""
