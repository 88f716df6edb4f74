"""The known message and service types with their fields, one per line.

``pkg/Type: type field; type field`` for a message, ``pkg/Type: request -> response`` for a service; an action has three
messages, ``pkg/TypeGoal``, ``pkg/TypeResult`` and ``pkg/TypeFeedback``. A ``|`` separates spellings of one type, of
ROS 1 and ROS 2 or of versions. A type without a package is in the package of its line; ``time`` and ``duration`` are
the built-in ones; ``any`` is any plain value; ``Type[?]`` is one or a list of them; ``type field=1`` has a default
other than zero.
"""

_NUMBERS = ("Int8", "Int16", "Int32", "Int64", "UInt8", "UInt16", "UInt32", "UInt64", "Float32", "Float64")
_OF_NUMBERS = "".join(
    f"std_msgs/{name}: {name.lower()} data\nstd_msgs/{name}MultiArray: MultiArrayLayout layout; {name.lower()}[] data\n"
    for name in _NUMBERS
)
DEFINITIONS = f"""{_OF_NUMBERS}
builtin_interfaces/Time: int32 sec; uint32 nanosec | uint32 secs; uint32 nsecs
builtin_interfaces/Duration: int32 sec; uint32 nanosec | int32 secs; int32 nsecs

std_msgs/Empty:
std_msgs/Bool: bool data
std_msgs/String: string data
std_msgs/Byte: byte data
std_msgs/Char: char data
std_msgs/Time: time data
std_msgs/Duration: duration data
std_msgs/Header: time stamp; string frame_id | uint32 seq; time stamp; string frame_id
std_msgs/ColorRGBA: float32 r; float32 g; float32 b; float32 a
std_msgs/MultiArrayDimension: string label; uint32 size; uint32 stride
std_msgs/MultiArrayLayout: MultiArrayDimension[] dim; uint32 data_offset
std_msgs/ByteMultiArray: MultiArrayLayout layout; byte[] data

geometry_msgs/Vector3: float64 x; float64 y; float64 z
geometry_msgs/Vector3Stamped: std_msgs/Header header; Vector3 vector
geometry_msgs/Point: float64 x; float64 y; float64 z
geometry_msgs/Point32: float32 x; float32 y; float32 z
geometry_msgs/PointStamped: std_msgs/Header header; Point point
geometry_msgs/Quaternion: float64 x; float64 y; float64 z; float64 w=1
geometry_msgs/QuaternionStamped: std_msgs/Header header; Quaternion quaternion
geometry_msgs/Pose: Point position; Quaternion orientation
geometry_msgs/Pose2D: float64 x; float64 y; float64 theta
geometry_msgs/PoseArray: std_msgs/Header header; Pose[] poses
geometry_msgs/PoseStamped: std_msgs/Header header; Pose pose
geometry_msgs/PoseWithCovariance: Pose pose; float64[36] covariance
geometry_msgs/PoseWithCovarianceStamped: std_msgs/Header header; PoseWithCovariance pose
geometry_msgs/Polygon: Point32[] points
geometry_msgs/Transform: Vector3 translation; Quaternion rotation
geometry_msgs/TransformStamped: std_msgs/Header header; string child_frame_id; Transform transform
geometry_msgs/Twist: Vector3 linear; Vector3 angular
geometry_msgs/TwistStamped: std_msgs/Header header; Twist twist
geometry_msgs/TwistWithCovariance: Twist twist; float64[36] covariance
geometry_msgs/TwistWithCovarianceStamped: std_msgs/Header header; TwistWithCovariance twist
geometry_msgs/Wrench: Vector3 force; Vector3 torque
geometry_msgs/WrenchStamped: std_msgs/Header header; Wrench wrench

sensor_msgs/JointState: std_msgs/Header header; string[] name; float64[] position; float64[] velocity; float64[] effort
sensor_msgs/LaserScan: std_msgs/Header header; float32 angle_min; float32 angle_max; float32 angle_increment; \
float32 time_increment; float32 scan_time; float32 range_min; float32 range_max; float32[] ranges; float32[] intensities
sensor_msgs/Image: std_msgs/Header header; uint32 height; uint32 width; string encoding; uint8 is_bigendian; \
uint32 step; uint8[] data
sensor_msgs/CompressedImage: std_msgs/Header header; string format; uint8[] data
sensor_msgs/RegionOfInterest: uint32 x_offset; uint32 y_offset; uint32 height; uint32 width; bool do_rectify
sensor_msgs/CameraInfo: std_msgs/Header header; uint32 height; uint32 width; string distortion_model; float64[] d; \
float64[9] k; float64[9] r; float64[12] p; uint32 binning_x; uint32 binning_y; RegionOfInterest roi \
| std_msgs/Header header; uint32 height; uint32 width; string distortion_model; float64[] D; \
float64[9] K; float64[9] R; float64[12] P; uint32 binning_x; uint32 binning_y; RegionOfInterest roi

nav_msgs/Odometry: std_msgs/Header header; string child_frame_id; geometry_msgs/PoseWithCovariance pose; \
geometry_msgs/TwistWithCovariance twist

trajectory_msgs/JointTrajectoryPoint: float64[] positions; float64[] velocities; float64[] accelerations; \
float64[] effort; duration time_from_start
trajectory_msgs/JointTrajectory: std_msgs/Header header; string[] joint_names; JointTrajectoryPoint[] points

std_srvs/Empty: ->
std_srvs/Trigger: -> bool success; string message
std_srvs/SetBool: bool data -> bool success; string message

rosapi/GetTime: -> time time
rosapi/Topics: -> string[] topics; string[] types
rosapi/TopicType: string topic -> string type
rosapi/Services: -> string[] services
rosapi/ServiceType: string service -> string type
rosapi/GetActionServers: -> string[] action_servers
rosapi/ActionType: string action -> string type

controller_manager_msgs/ControllerState: string name; string state; string type; uint16 update_rate; \
string[] claimed_interfaces; \
string[] required_command_interfaces; string[] required_state_interfaces
controller_manager_msgs/ListControllers: -> ControllerState[] controller
control_msgs/GripperCommand: float64 position; float64 max_effort
control_msgs/GripperCommandGoal: GripperCommand command
control_msgs/GripperCommandResult: float64 position; float64 effort; bool stalled; bool reached_goal
control_msgs/GripperCommandFeedback: float64 position; float64 effort; bool stalled; bool reached_goal
control_msgs/ParallelGripperCommandGoal: sensor_msgs/JointState command
control_msgs/ParallelGripperCommandResult: sensor_msgs/JointState state; bool stalled; bool reached_goal
control_msgs/ParallelGripperCommandFeedback: sensor_msgs/JointState state
franka_msgs/GraspEpsilon: float64 inner; float64 outer
franka_msgs/MoveGoal: float64 width; float64 speed
franka_msgs/MoveResult: bool success; string error
franka_msgs/MoveFeedback: float64 current_width
franka_msgs/GraspGoal: float64 width; GraspEpsilon epsilon; float64 speed; float64 force
franka_msgs/GraspResult: bool success; string error
franka_msgs/GraspFeedback: float64 current_width
xarm_msgs/SetInt16: int16 data -> int16 ret; string message
xarm_msgs/SetInt16ById: int16 id; int16 data -> int16 ret; string message

bam_msgs/ErrorCode: int32 value
bam_msgs/RequestHeader: string client_id; uint8 request_type; bool force_busy; bool force_uncalibrated; \
bool force_priority; time stamp; string frame_id; float64 expected_duration; bool blocking; int32 priority; \
bool clear_priority \
| string client_id; uint8 request_type; bool force_if_busy; bool force_uncalibrated; \
bool force_priority; time stamp; string frame_id; float64 expected_duration; bool blocking; int32 priority; \
bool clear_priority
bam_msgs/WaypointParams: float64 kp_scale; float64 kd_scale; float64 max_velocity; float64 max_effort; \
string target_link; string planner; float64 vel_scale; float64 accel_scale; float64 blend_radius; float64 goal_tol; \
float64 path_tol; float64 vertical_angle_scale; float64 gripper_width
bam_msgs/GymAction: uint8 action_type; string ns; string prefix; string[] discrete_names; int64[] discrete_action; \
string[] continuous_names; float64[] continuous_action; string[] pose_names; geometry_msgs/PoseStamped[] pose_action; \
WaypointParams[] pose_param; int64[] target_class; int64 rank
bam_msgs/ResponseHeader: float64 process_duration; float64 transport_duration; ErrorCode error_code; \
string error_msg; bool calibrated; time response_stamp \
| float64 duration; ErrorCode error_code; string error_msg; bool calibrated
bam_msgs/GymFeedback: string ns; string[] observation_names; float64[] observation; string[] pose_names; \
geometry_msgs/PoseStamped[] pose; int64[] target_class; sensor_msgs/CompressedImage[?] color_img; \
sensor_msgs/Image[?] depth_img; sensor_msgs/CameraInfo[?] camera_info; any[] detections; any[] masks; any[] segments; \
bool duplicate_obs_ns; bool duplicate_obs; int64 duplicate_index; bool executed; float64 reward; bool terminated; \
bool truncated; string info
bam_msgs/GymAPI: RequestHeader header; int64 seed; string env_name; GymAction[] action \
-> ResponseHeader header; GymFeedback[] feedback
"""
