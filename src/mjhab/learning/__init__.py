"""Policies that learn: imitation of demonstrations, and take-over DAgger. Needs the extra ``[learn]`` (torch)."""
