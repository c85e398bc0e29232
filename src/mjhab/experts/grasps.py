from mjhab.envs.grasps import *  # noqa: F403
