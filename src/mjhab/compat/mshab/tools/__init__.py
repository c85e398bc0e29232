"""Functions of ManiSkill and MS-HAB that scripts call on observations, infos and recorded arrays."""
