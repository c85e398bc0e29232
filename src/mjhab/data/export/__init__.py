"""Export of recorded episodes to the formats of LeRobot and ManiSkill (MS-HAB)."""
