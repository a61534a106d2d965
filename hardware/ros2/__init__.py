"""ROS 2 topics without a ROS installation, through Cyclone DDS (package ``cyclonedds``, extra ``ros2``)."""
