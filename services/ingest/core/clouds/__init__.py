"""Clouds of points as depth images: files and messages, movement of the sensor, upsampling, views without a camera."""
