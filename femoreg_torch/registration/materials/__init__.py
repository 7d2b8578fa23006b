"""What a device is made of, estimated from the images."""
