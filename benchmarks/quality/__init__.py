"""Quality of images, scenes and scripted experts."""
