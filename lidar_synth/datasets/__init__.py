"""Facts about public datasets: their classes, drives and splits."""
