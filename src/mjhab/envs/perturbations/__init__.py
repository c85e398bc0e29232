"""The axes of perturbations that come with mjhab, one file each, see `config.perturbing`."""
