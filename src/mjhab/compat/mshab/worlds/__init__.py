"""The worlds behind MS-HAB's ids: its arguments, observations, `info` and attributes over mjhab's environments."""
