"""Published models with an image and a text tower, written as the folder that `onnx:FOLDER` reads."""
