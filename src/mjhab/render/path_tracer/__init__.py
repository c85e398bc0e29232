"""Pictures by a path tracer, Mitsuba 3: ``shader="path"``."""
