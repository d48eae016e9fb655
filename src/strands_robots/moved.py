"""Import paths of strands-robots 0.5, and where each name is here.

A package asks :func:`moved_name` for what it does not have, and :func:`spec_of` finds the modules that have another
name here. Nothing is loaded before it is asked for.
"""

from __future__ import annotations

import sys
from importlib import import_module

TYPE_CHECKING = False  # importing typing would be most of this import's time
if TYPE_CHECKING:
    from collections.abc import Callable
    from importlib.machinery import ModuleSpec
    from types import ModuleType
    from typing import Any

_HERE = "strands_robots"

MODULES = {
    f"{_HERE}.{old}": f"{_HERE}.{new}"
    for old, new in {
        "device_connect.sim_driver": "device_connect.simulation_driver",
        "drivers.ros._mobile_base": "drivers.ros.mobile_base",
        "hardware_robot": "hardware",
        "inference": "policies.remote",
        "inference.client": "policies.remote",
        "mesh.transport.base": "mesh.transport",
        "mesh.transport.bridge_transport": "mesh.transport.bridge",
        "mesh.transport.iot_transport": "mesh.transport.iot",
        "mesh.transport.zenoh_transport": "mesh.transport.zenoh",
        "policies.factory": "policies",
        "policies.mock": "policies.base",
        "rosbridge": "ros.rosbridge",
        "simulation.mujoco": "simulation",
        "simulation.mujoco.simulation": "simulation",
        "tools.use_ros": "tools:use_ros",
        "tools.use_rosbridge": "tools:use_rosbridge",
        "tools.use_rtps": "tools:use_rtps",
    }.items()
}
"""Modules by their path in 0.5; a tool's module is the tool."""


def _names(home: str, package: str, names: str) -> dict[str, str]:
    return {f"{_HERE}{package and '.'}{package}.{name}": f"{_HERE}.{home}:{name}" for name in names.split()}


_ROS_ROBOTS = {
    "AckermannRosRobot": "drivers.ros.ackermann_robot",
    "MobileBaseRobot": "drivers.ros.mobile_base",
    "RosBridgedRobot": "drivers.ros.ros_bridge",
    "RosbridgeRobot": "drivers.ros.rosbridge_robot",
    "RtpsRobot": "drivers.ros.rtps_robot",
}
_BRIDGES = {"HardwareRosBridge": "hardware_ros_bridge", "HardwareRtpsBridge": "hardware_rtps_bridge"}

NAMES = {
    **{f"{_HERE}.drivers.ros.{name}": f"{_HERE}.{home}:{name}" for name, home in _ROS_ROBOTS.items()},
    **{f"{_HERE}.mesh.{name}": f"{_HERE}.{home}:{name}" for name, home in {**_ROS_ROBOTS, **_BRIDGES}.items()},
    **{f"{_HERE}.{name}": f"{_HERE}.{home}:{name}" for name, home in _BRIDGES.items()},
    **_names("policies.base", "", "Policy MockPolicy"),
    **_names("policies", "", "create_policy"),
    f"{_HERE}.list_providers": f"{_HERE}.policies:policy_names",
    f"{_HERE}.policies.list_providers": f"{_HERE}.policies:policy_names",
    f"{_HERE}.policies.factory.list_providers": f"{_HERE}.policies:policy_names",
    **_names("policies.base", "policies", "MockPolicy"),
    **_names("tools", "", "robot_mesh use_ros use_rosbridge use_rtps"),
    **_names(
        "device_connect",
        "",
        "ReachyMiniDriver RobotDeviceDriver SimulationDeviceDriver init_device_connect init_device_connect_sync",
    ),
    **_names("mesh.input", "mesh", "InputPublisher InputReceiver"),
    **_names(
        "mesh.session",
        "mesh",
        "clear_peers current_session get_peers get_session prune_peers put release_session session_alive update_peer",
    ),
    **_names("audit", "mesh", "log_safety_event"),
    f"{_HERE}.mesh.resume_authority.generate_signing_key": f"{_HERE}.mesh.resume_authority:keygen",
    **_names("safety.orders", "mesh.resume_authority", "new_epoch"),
    **_names("ros.gate", "ros", "CommandGate"),
    f"{_HERE}.mesh.transport.MeshTransport": f"{_HERE}.mesh.transport:Transport",
    f"{_HERE}.mesh.transport.SubHandle": f"{_HERE}.mesh.transport:Declaration",
    f"{_HERE}.policies.lerobot_local.LerobotLocalPolicy": f"{_HERE}.policies.lerobot_local:LeRobotPolicy",
    f"{_HERE}.hardware_robot.Robot": f"{_HERE}.hardware:HardwareRobot",
    f"{_HERE}.inference.RemotePolicy": f"{_HERE}.policies.remote:RemotePolicy",
    **{
        f"{_HERE}.{package}.{name}": f"{_HERE}.simulation:Simulation"
        for package in ("simulation", "simulation.mujoco", "simulation.mujoco.simulation")
        for name in ("MuJoCoSimEngine", "MuJoCoSimulation")
    },
}
"""Names by their path in 0.5, each with its module and its name here."""

_KEEPS = "strands-robots 0.5 keeps it"
_NO_DRIVER = f"{_KEEPS}; a package brings a robot by the entry point strands_robots.robots (docs/your-robot.md)"
_NO_ROBOT_LIST = (
    "Robot takes the name of a robot, or the path of an MJCF or URDF file; 'strands-robots peers' lists the live ones"
)
_NO_POLICY = f"{_KEEPS}; a package brings a policy by the entry point strands_robots.policies (docs/policies.md)"
_PRELOADED = "a policy profile is loaded before a robot moves by it (docs/policies.md)"
_ONE_CLASS = "strands_robots.policies.lerobot_local has one class, LeRobotPolicy, for every type of LeRobot's"
_PAGE = "'strands-robots dashboard' serves the page of this release"
_ENGINE = f"{_KEEPS}; the one engine here is strands_robots.Simulation, in MuJoCo"
_EVALUATE = "'strands-robots eval' and strands_robots.evaluation judge policies by task"
_TRAIN = f"{_KEEPS}; train with LeRobot and run the checkpoint by policy_provider lerobot_local"
_LEROBOT = "LeRobot's own commands do it"
_RECORD = (
    "'strands-robots record' writes the events of a device into an MCAP file, which strands_robots.recording reads"
)
_STREAM = f"{_KEEPS}; LeRobot's StreamingLeRobotDataset reads a dataset from the Hub"
_TELEOP = "'strands-robots teleop' leads an arm; strands_robots.teleoperators has keyboards, gamepads and recordings"
_TRANSPORT = "STRANDS_MESH_BACKEND chooses the transport, and init_mesh opens it"
_ARM_VERBS = "the verbs moveJoints, moveTo and goTo move an arm, in simulation and real"
_REACHY = f"{_KEEPS}; ReachyMiniDriver has the verbs of this release (docs/reachy-mini.md)"
_BOUNDS = "its value is in docs/reference.md, with the settings and bounds of this release"
_CHECKED = "strands_robots.mesh.security has the checks of this release: validate_command, validate_input_frame"
_SIGNED = "strands_robots.mesh.resume_authority has keygen, load_signing_key, sign and ResumeVerifier"
_IDENTITY = "strands_robots.mesh.wire_identity has an Identity, which signs and verifies"
_APPROVAL = "strands_robots.safety.authorization decides who may move a robot"
_OWN_HELPER = f"{_KEEPS} for itself, and programs have their own"
_DDS = "strands_robots.tools.use_rtps speaks DDS, and strands_robots.ros.dds is its link"

_INSTEAD = (
    ("", "assets registry get_robot is_discoverable list_discoverable list_robots list_urdf_only", _NO_ROBOT_LIST),
    ("", "download_assets", "Robot finds its built-in models without a download; any other is given by its path"),
    ("", "create_simulation list_backends register_backend", _ENGINE),
    ("", "SimCamera SimObject SimRobot SimWorld", "strands_robots.Simulation names robots, objects and cameras"),
    ("", "list_policy_types", "strands_robots.policies.policy_names lists the policies"),
    ("", "register_policy", _NO_POLICY),
    ("", "Teleoperator teleoperator lerobot_teleoperate", _TELEOP),
    ("", "teleop", f"{_KEEPS}; {_TELEOP}"),
    ("", "training lerobot_train train_policy", _TRAIN),
    ("", "StreamingDatasetReader stream_dataset streaming_dataset dataset_source dataset_metadata", _STREAM),
    ("", "sync_dataset_to_bucket dataset_transfer", f"{_KEEPS}; hf upload puts a dataset on the Hub"),
    ("", "dataset_recorder recorder recording_errors", _RECORD),
    ("", "verify_dataset episode_labels", f"{_KEEPS}; {_LEROBOT}"),
    ("", "run_policy", "robot.start_task and the verb execute run a policy"),
    ("", "pose_tool", _ARM_VERBS),
    ("", "lerobot_camera", "the verb getPicture takes a picture"),
    ("", "serial_tool use_lerobot", f"{_KEEPS}; 'strands-robots calibrate' and 'strands-robots doctor' look at an arm"),
    ("", "harness_memory", _KEEPS),
    ("", "create_judge_agent load_episode sample_frames read_predicate_verdict write_label", _EVALUATE),
    ("", "foxglove", f"{_KEEPS}; Foxglove opens the MCAP files of 'strands-robots record'"),
    ("", "rendering locomotion_envelope hardware_observe refusal_codes", _KEEPS),
    ("", "rtps", _DDS),
    ("", "doctor", "the command is 'strands-robots doctor'"),
    ("", "__main__", "the command is 'strands-robots', or python -m strands_robots.cli"),
    ("inference", "PolicyServer server protocol", f"{_KEEPS}; policy_provider remote, openpi and groot ask a server"),
    ("device_connect", "resolve_allow_insecure", "init_device_connect reads DEVICE_CONNECT_ALLOW_INSECURE"),
    (
        "drivers",
        "DRIVER_SURFACE HardwareDriver constructor_keywords drifted_driver_parameters driver_choice_error "
        "get_native_driver_class halt_failure_detail list_driver_coverage list_native_drivers missing_driver_members "
        "port_kind register_native_driver resolve_driver shipped_robot_names base booster cameras composite crazyflie "
        "dynamixel earthrover feetech franka g1 go2 kinova kuka kuka_session microduck rby1 registry robotiq rollout "
        "spot stretch unitree ur xarm yahboom_m3pro yahboom_m3pro_twin yahboom_m3pro_wire",
        _NO_DRIVER,
    ),
    ("drivers", "reachy_doa reachy_envelope reachy_look_at reachy_media reachy_vocabulary", _REACHY),
    (
        "drivers.ros",
        "ActionCapable ServiceCapable Transport",
        "strands_robots.ros.link has the links of this release: RosLink, GoalLink",
    ),
    (
        "mesh.core",
        "BROADCAST_RESPONDER CMD_PACE_MARGIN_S MAX_DEGRADED_DETAIL_LEN RESUME_FORWARD_SKEW_S "
        "RESUME_FRESHNESS_WINDOW_S RESUME_REPLAY_CACHE_MAX SIM_CALL_MAX_IMAGE_BYTES SIM_CALL_MAX_TEXT_CHARS",
        _BOUNDS,
    ),
    (
        "mesh.core",
        "PERMISSIVE_ACL_REFUSAL WIRE_MOTION_ACTIONS WIRE_MOTION_ALLOW_ENV WireSource allow_match remote_motion_refusal",
        _APPROVAL,
    ),
    ("mesh.input", "INPUT_AUDIT_EVERY_DEFAULT INPUT_MAX_HZ_DEFAULT", _BOUNDS),
    (
        "mesh.resume_authority",
        "ASSERTION_VERSION MAX_TARGETS PASSPHRASE_MIN_CLASSES PASSPHRASE_MIN_DISTINCT PASSPHRASE_MIN_LEN "
        "PUBLIC_KEY_ENV SIGNING_KEY_FILE_ENV check_assertion is_epoch passphrase_problem public_key_text "
        "sign_assertion signing_key_path verify_keys",
        _SIGNED,
    ),
    (
        "mesh.security",
        "ALLOWED_ACTIONS INPUT_ENVELOPE_FULL_SCALES INPUT_FULL_SCALE_BY_NORM_MODE LOCKOUT_ADMITTED_ACTIONS "
        "LockoutError MAX_CALL_NAME_LEN MAX_CALL_PARAMS_BYTES MAX_DC_RPC_FUNC_LEN MAX_DC_RPC_PARAMS_BYTES "
        "MAX_DURATION_S MAX_INPUT_FRAME_KEYS MAX_INPUT_KEY_LEN MAX_INPUT_SLEW_ABS MAX_INPUT_VALUE_ABS "
        "MAX_INSTRUCTION_LEN MAX_MODEL_PATH_LEN MAX_PASSTHROUGH_LEN MAX_PEER_ID_LEN MAX_RESUME_ASSERTION_BYTES "
        "MAX_SERVER_ADDRESS_LEN MAX_SIM_CALL_NAME_LEN MAX_SIM_CALL_PARAMS_BYTES MAX_TARGET_JOINTS "
        "MAX_WORLD_UPDATE_BYTES SIM_CALL_DENIED_ACTIONS SIM_CALL_DENIED_PARAMS SIM_CALL_RAIL_FOR SecurityError "
        "as_wire_timestamp input_frame_slew_violation input_value_abs_by_key is_safe_model_path is_safe_policy_host "
        "is_safe_policy_provider is_safe_policy_type is_safe_server_address merge_slew_baseline "
        "sim_call_allowed_actions sim_call_allowed_params sim_call_published_actions sim_call_published_params "
        "validate_device_rpc",
        _CHECKED,
    ),
    (
        "mesh.session",
        "CAMERA_HZ FALLBACK_MODE_DEFAULT FALLBACK_RETRY HAND_HZ HEALTH_HZ HEARTBEAT_HZ IMU_HZ LIDAR_STATE_HZ "
        "LIDAR_SUMMARY_HZ MAP_INFO_HZ MAX_PEERS_DEFAULT ODOM_HZ PEER_RETENTION_DEFAULT POSE_HZ STATE_HZ STREAM_HZ "
        "hz_from_env stream_min_period_from_env",
        _BOUNDS,
    ),
    ("mesh.session", "peer_count peer_is_physical", "get_peers lists the peers, each with its type"),
    ("mesh.session", "zenoh_backend_missing", "'strands-robots doctor' says what is not installed"),
    ("mesh.transport.factory", "current_backend current_transport get_transport release_transport", _TRANSPORT),
    (
        "mesh.wire_identity",
        "MAX_CERT_DER_BYTES REQUIRE_ENV ReplayGuard SIG_FIELD TrustRoots WireIdentity cn_speaks_for sign "
        "signing_required verify",
        _IDENTITY,
    ),
    ("bus_access", "motor_norm_modes read_observation write_action", "bus_access has read_joints and write_joints"),
    *(
        (each, "HardwareLink ImuCallback JointsCallback identity_pose resolve_host rpy_to_pose", _REACHY)
        for each in ("device_connect.reachy_transport", "drivers.reachy_transport")
    ),
    (
        "policies.base",
        "ChunkedPolicy align_action_values chunk_count_error collect_required_bodies instruction_not_read_notice "
        "iter_policy_tree provider_policy_class required_bodies_error resolve_chunk_length",
        _NO_POLICY,
    ),
    ("drivers.reachy", "DEFAULT_API_PORT", "the api_port of ReachyMiniDriver is 8000 by default"),
    ("ros", "GATE_TOOL never_gated", "strands_robots.ros.gate asks the operator"),
    ("ros_telemetry", "ROS2_INSECURE_ENV ROS2_SYSTEM_INSTALL_HINT", _BOUNDS),
    ("teleop_mixin", "AttachedTeleop", _OWN_HELPER),
    (
        "audit",
        "AuditPSKDegradedError",
        "log_safety_event never raises; what is not on the disk is logged as CRITICAL",
    ),
    (
        "utils",
        "base_dir_path boolean_flag_error camera_name_error dds_domain_id_error did_you_mean entity_name_error "
        "finite_number_error finite_vector_error get_assets_dir get_base_dir get_search_paths is_boolean log_safe "
        "non_negative_count_error non_negative_whole_number_error partial_construction_repr positive_count_error "
        "positive_finite_number_error positive_whole_number_error refusal_repr refusal_str require_optional "
        "require_optionals resolve_asset_path safe_join tcp_port_error torch_device_error "
        "BOOLEAN_VECTOR_REASON BUCKET_STREAMING_MIN_LEROBOT CREDENTIAL_KEY_WORDS DEFAULT_BASE_DIR "
        "FREE_CAMERA_TOKENS LEROBOT_UPGRADE MAX_DDS_DOMAIN_ID MAX_ZMQ_TIMEOUT_MS MIN_QUATERNION_NORM "
        "RGBA_ACCEPTED_LENGTHS RGBA_LAYOUT camera_fov_error camera_schema_key camera_token_error "
        "coerce_orientation_quaternion coerce_pose_vector coerce_rgba coerce_size_vector coerce_zmq_timeout_ms "
        "declared_count effective_episode_count ensure_lerobot_family_registered ensure_lerobot_plugins_registered "
        "episode_subset_budget_error free_camera_routing_rank is_credential_key lerobot_floor_error "
        "lerobot_install_error lerobot_version mounted_camera_pose_error name_list_error optional_callable_error "
        "orientation_quaternion_error pose_vector_error process_rss_mb published_string_error redact_config_pairs "
        "refusal_container_repr refuse_dropped_connection_kwargs reserved_camera_name_error "
        "scoped_camera_name_error sequence_length stale_output_dir_is_clearable step_aborted_msg "
        "step_cadence_error validation_split_error validation_split_fraction",
        _OWN_HELPER,
    ),
    ("mesh", "iot", f"{_KEEPS}; STRANDS_MESH_BACKEND=iot joins with a thing that is provisioned already"),
    ("mesh", "pacing", "the mesh paces itself (docs/mesh.md)"),
    ("mesh.transport", "get_transport release_transport current_transport current_backend", _TRANSPORT),
    ("mesh.transport", "DIRECT_REASONS DirectResult DirectSender", "Mesh.ping says whether an answer was direct"),
    (
        "policies",
        "ChunkedPolicy Cosmos3Policy CompositePolicy align_action_values chunk_count_error composite "
        "construction_failure_keeps_its_raise cosmos3 curobo flux3_action holosoma import_policy_class "
        "isaaclab_actuator_pd kimodo list_aliases list_policy_types microduck moveit2 policy_mapping_error "
        "policy_object_error policy_overrides_preflight policy_provider_error preflight_policy preflight_reason "
        "protomotions register_policy required_bodies_error resolve_chunk_length rl rsl_rl_onnx wbc wbc_latent",
        _NO_POLICY,
    ),
    ("policies", "PersistentPolicy evict list_cached persistent", _PRELOADED),
    ("policies.lerobot_local", "clear_model_cache list_cached_models", _PRELOADED),
    ("policies.lerobot_local", "embodiment list_policy_types molmoact2 policy processor resolution", _ONE_CLASS),
    ("policies", "UntrustedRemoteCodeError", "no policy of this release runs code of a checkpoint"),
    (
        "simulation",
        "ActionResolution IsaacConfig IsaacSimulation LegacyHookOutcome SimEngine SimStatus SpecBuilder base "
        "capabilities create_simulation factory ik isaac list_backends mjlab model_registry models "
        "motion_primitives_base newton obs_noise policy_runner recording register_backend safe_output seeds terrain "
        "tool_frame video_config",
        _ENGINE,
    ),
    ("simulation", "SimCamera SimObject SimRobot SimWorld", "Simulation names robots, objects and cameras"),
    (
        "simulation",
        "list_available_models list_registered_urdfs register_urdf resolve_model resolve_urdf",
        "Simulation.add_robot takes the path of an MJCF or URDF file",
    ),
    (
        "simulation",
        "RunPolicyEnded RunPolicyEvent RunPolicyObserver RunPolicyOutcome RunPolicyStarted RunPolicyStep StoppedReason "
        "TrajectoryStep observers",
        "Simulation.subscribe gives a strands_robots.contract.RolloutEvent",
    ),
    (
        "simulation",
        "BenchmarkCompatibilityError BenchmarkProtocol DeclarativeBenchmark PREDICATE_REGISTRY StepInfo benchmark "
        "benchmark_spec builtin_benchmark_specs builtin_benchmarks get_benchmark list_benchmarks make_predicate "
        "predicates register_benchmark register_benchmark_from_file register_builtin_benchmarks register_predicate "
        "task_objects unregister_benchmark",
        _EVALUATE,
    ),
    (
        "simulation.mujoco",
        "backend divergence manipulation motion_primitives physics randomization recording rendering scene_ops "
        "spec_builder wire_surface",
        _ENGINE,
    ),
    ("tools", "download_assets", _NO_ROBOT_LIST),
    ("tools", "episode_judge", _EVALUATE),
    ("tools", "harness_memory g1", _KEEPS),
    ("tools", "lerobot_camera", "the verb getPicture takes a picture"),
    ("tools", "lerobot_teleoperate", _TELEOP),
    ("tools", "lerobot_train train_policy", _TRAIN),
    ("tools", "pose_tool", _ARM_VERBS),
    ("tools", "reachy", "robot_mesh and the MCP server call the verbs of a Reachy Mini (docs/agents.md)"),
    ("tools", "run_policy", "robot.start_task and the verb execute run a policy"),
    ("tools", "serial_tool use_lerobot", f"{_KEEPS}; {_LEROBOT}"),
    (
        "dashboard",
        "agent_console agent_hitl agent_motion argv_exposure arm_roles artifact_check auth build_info bus_claim "
        "calibration calibration_run camera_liveness cameras checkpoints churn_guard cli config_api consent "
        "dataset_check deploy device_manager direct_serial disk_headroom env_install episode_label_view fleet "
        "health_ingest joint_silence lan_hint log_redaction mesh_bridge mirror output_dir_check peer_policies "
        "peer_tools policy_fit record_api record_crash record_joints record_motion record_worker refusals routes_agent "
        "routes_auth routes_config routes_consent routes_devices routes_env routes_mesh routes_record routes_sim "
        "routes_train routes_voice safety_state scene settings sim_session task_timeout teleop_health training "
        "ttl_cache upload_preflight validate_scope voice ws_observability",
        _PAGE,
    ),
)

GONE = {
    f"{_HERE}{package and '.'}{package}.{name}": instead
    for package, names, instead in _INSTEAD
    for name in names.split()
}
"""What is not here, by its path in 0.5, and what to use instead. A package stands for what is in it."""

_STREAMS = "strands_robots.mesh.input has InputPublisher and InputReceiver (docs/mesh.md)"
_CAMERAS = "a model's file has its cameras; get_features lists them, and in simulation render draws what one sees"
_MODEL_FILE = "Robot takes the path of an MJCF or URDF file, and add_object puts objects into its world"

_METHODS = (
    ("stop", "halt stops the robot, and cleanup frees it"),
    ("destroy close_viewer", "cleanup frees the robot and its world"),
    ("start_teleop_publish start_teleop_receive", _STREAMS),
    (
        "stop_teleop",
        "the stop of InputPublisher and InputReceiver ends a stream, stop_teleoperate a leader here, and halt all",
    ),
    ("get_teleop_status", "InputPublisher and InputReceiver have stats, and teleop_status tells of leaders here"),
    ("get_teleoperate_status list_teleops", "teleop_status lists the leaders"),
    ("detach_teleop", "stop_teleoperate ends a leader, and attach_teleop replaces one of the same name"),
    ("start_recording stop_recording get_recording_status save_episode verify_dataset_episodes", _RECORD),
    ("foxglove_link foxglove_url", "Foxglove opens the MCAP files of 'strands-robots record'"),
    (
        "start_cameras_recording start_cameras_recording_synchronous stop_cameras_recording "
        "get_cameras_recording_status",
        "strands_robots.simulation.rendering.Recording makes an animation of a world (docs/simulation.md)",
    ),
    ("stream_dataset", _STREAM),
    ("replay_episode", "'strands-robots replay' plays a recording to a robot"),
    (
        "eval_policy evaluate_benchmark list_benchmarks register_benchmark_from_file register_builtin_benchmarks",
        _EVALUATE,
    ),
    (
        "add_camera remove_camera list_cameras list_cameras_info get_camera_params get_frame render_all render_depth",
        _CAMERAS,
    ),
    ("open_viewer", "'strands-robots dashboard' shows a robot that is served"),
    ("list_objects list_bodies get_body_state", "get_objects lists the objects with their places"),
    ("move_object", "remove_object takes an object away, and add_object puts it elsewhere"),
    ("list_robots_info get_robot_state get_status", "get_state has the joints and tasks of each robot"),
    ("robot_joint_names robot_action_keys actuator_ranges capabilities", "get_features has joints and their ranges"),
    ("actuate_robot set_joint_positions rotate_wrist", "send_action and move_joints move the joints"),
    ("policy_result", "outcomes has how the last policy of each robot ended"),
    ("run_multi_policy", "start_policy starts one for each robot, and returns at once"),
    ("run_policy", "start_task runs a policy"),
    ("load_scene replace_scene_mjcf patch_scene_mjcf register_urdf list_urdfs", _MODEL_FILE),
    ("set_gravity set_timestep physics_timestep", "Robot takes gravity and timestep for a simulation"),
    ("publish_ros_observation", "strands_robots.hardware_ros_bridge.HardwareRosBridge publishes a robot to ROS 2"),
    (
        "tool_name tool_spec tool_type stream wire_tool_spec",
        "the tool is robot_mesh (from strands_robots.tools import robot_mesh)",
    ),
    (
        "apply_force attach_bodies detach_bodies export_xml forward_kinematics get_contact_forces get_contacts "
        "get_energy get_ground_height get_jacobian get_mass_matrix get_sensor_data get_total_mass get_world_point "
        "inverse_dynamics load_state mj_data mj_model multi_raycast randomize raycast saturated_actuators save_state "
        "set_body_properties set_geom_properties set_joint_velocities set_obs_noise zero_dynamics",
        _KEEPS,
    ),
)

METHODS = {name: instead for names, instead in _METHODS for name in names.split()}
"""What a robot of 0.5 had and none has here, and what to use instead."""


def moved_name(package: str, name: str) -> Any:
    """Return what was called ``name`` in a package of 0.5.

    Raises:
        AttributeError: there is nothing of that name; what was there says what to use instead.
    """
    path = f"{package}.{name}"
    if path in NAMES:
        home, _, new = NAMES[path].partition(":")
        return getattr(import_module(home), new)
    raise AttributeError(_sentence(path) or f"module {package!r} has no attribute {name!r}")


def getter(package: str) -> Callable[[str], Any]:
    """Return the ``__getattr__`` of a package that has no other names."""
    return lambda name: moved_name(package, name)


def of_module(module: str) -> tuple[list[str], Callable[[str], Any]]:
    """Return ``__path__`` and ``__getattr__`` of a module that had more names.

    A module without a path is not asked why it has no such name: ``from module import name`` says that it has not.
    """
    return [], getter(module)


def spec_of(path: str) -> ModuleSpec | None:
    """Return the spec of a module of 0.5 that has another name here, or None.

    Raises:
        ImportError: it is not here, with what to use instead. ``from package import name`` asks for a module, too.
    """
    if path in MODULES:
        from importlib.machinery import ModuleSpec  # noqa: PLC0415 - importing this module costs next to nothing

        loader: Any = _MovedModule
        return ModuleSpec(path, loader, is_package=_has_names(path))
    sentence = _sentence(path)
    if sentence is None:
        return None
    raise ImportError(sentence)


class _MovedModule:
    """Loader of a module that has another name here."""

    @staticmethod
    def create_module(spec: ModuleSpec) -> None:
        return None

    @staticmethod
    def exec_module(module: ModuleType) -> None:
        path = module.__name__
        home, _, name = MODULES[path].partition(":")
        here: Any = import_module(home)
        if name:
            tool: Any = getattr(here, name)
            vars(tool)[name] = tool
            sys.modules[path] = tool
        elif not _has_names(path):
            # The module itself, so that what a program sets in it is set here.
            sys.modules[path] = here
        else:

            def moved_or_here(asked: str) -> Any:
                stated = f"{path}.{asked}" in (*NAMES, *GONE) or asked.startswith("__")
                return getattr(here, asked) if not stated and hasattr(here, asked) else moved_name(path, asked)

            vars(module)["__getattr__"] = moved_or_here


def _has_names(path: str) -> bool:
    return any(each.startswith(f"{path}.") for each in (*NAMES, *GONE, *MODULES))


def _sentence(path: str) -> str | None:
    return None if path not in GONE else f"{path} is not in this release: {GONE[path]}."
