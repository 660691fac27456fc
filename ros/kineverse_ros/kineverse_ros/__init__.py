"""ROS 2 nodes: any model as TF, joint states and markers, and robots that skills move by topics."""
