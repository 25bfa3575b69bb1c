"""What several effects are measured with."""
