"""MS-HAB's files: task plans, the episodes they name, spawn data, grasp poses."""
