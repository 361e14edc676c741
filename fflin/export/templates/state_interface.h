#define ${NAME}_JOINTS $joints
#define ${NAME}_JOINTS_MAX $joints_max
#define ${NAME}_STATES $states

/* Measured quantities. World: the frame relative to which fflin gives the pose of the base$world.
 * joints[] and joint_rates[], in this order:
$joint_list
 */
typedef struct {
    ${name}_real attitude[4]; /* base quaternion x, y, z, w, from base to world axes; either sign */
    ${name}_real position[3]; /* base origin in world axes [m] */
    ${name}_real joints[${NAME}_JOINTS_MAX];
    ${name}_real angular_velocity[3]; /* of the base relative to the world, base axes [rad/s] */
    ${name}_real velocity[3]; /* of the base origin relative to the world, world axes [m/s] */
    ${name}_real joint_rates[${NAME}_JOINTS_MAX];
} ${name}_measured;

${memory_interface}/* Write the state x. q_b is the vector part of the quaternion relative to the reference, with
 * scalar part >= 0; the angle of a continuous joint is within half a turn of its target.
 * The status is OK or INVALID. If it is INVALID, x is zero.
$state_list
 */
int ${name}_state(${sample_argument}const ${name}_measured *measured, ${name}_real x[${NAME}_STATES]);

/* Write the inputs u = u0 - K (x - x0)$gains_between.$sample_comment
 * If the status is INVALID, u is u0 within the limits${memory_comment}.
$input_list
 */
int ${name}_step(${memory_argument}${sample_argument}const ${name}_measured *measured, ${name}_real u[${NAME}_INPUTS]);
