"""What a robot is: joints, links, gains, geometry, kinematics, controllers."""
