"""Sources whose depth comes from a lidar: folders of clouds, and PointCloud2 in recordings of ROS."""
