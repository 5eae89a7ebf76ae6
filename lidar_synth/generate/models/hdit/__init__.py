"""HDiT, the hourglass transformer of R2Flow (pixel models and the town's latent flow)."""
