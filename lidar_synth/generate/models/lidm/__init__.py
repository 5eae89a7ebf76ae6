"""The networks of LiDM: convolutional U-Net and VQ-VAE."""
