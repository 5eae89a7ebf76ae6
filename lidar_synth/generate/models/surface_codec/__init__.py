"""The autoencoder of dense models: a patch of a range image has a few surfaces, and each cell shows
one of them."""
