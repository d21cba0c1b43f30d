"""One file a method, all behind the interface of `base`."""
