"""Wrappers of MS-HAB and ManiSkill, under their names and arguments."""
