"""What older versions of mjhab wrote, read as what the present one writes."""
