"""Kind `reality`: detectors on annotated photographs, and textures pasted onto the cars in them."""
