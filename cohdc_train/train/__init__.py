"""Training: `cohdc fit` and the Lightning module around the network."""
