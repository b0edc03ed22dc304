"""The tactile sensing chain of one gel: image → markers → depth → 3-D markers in F_S."""
