"""What is measured on a model: thickness, points, single places, histograms, sheets of sections."""
