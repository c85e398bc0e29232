"""Results of the MS-HAB paper, reproduced: policies are trained, judged, and set beside the paper's numbers."""
