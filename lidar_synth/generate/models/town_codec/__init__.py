"""The small autoencoder of the shipped models, whose decoder predicts distributions per cell."""
