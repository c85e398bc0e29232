"""What scripts of MS-HAB import, answered by mjhab."""
