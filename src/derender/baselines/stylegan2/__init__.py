"""StyleGAN2 and its inversion in plain torch.

layers: resampling, modulated convolution; generator, discriminator: the networks; adversarial: how they
learn; e4e: from a picture to the generator's codes; inversion: how that learns; published: others' files.
"""
