"""Lane keeping by the markings in a camera image: detection, filter, steering and the driver."""
