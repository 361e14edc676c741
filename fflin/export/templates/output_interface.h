#define ${NAME}_MEMORY $states
#define ${NAME}_MEMORY_MAX $states_max
#define ${NAME}_OUTPUTS $outputs

/* Memory of the controller; the caller owns it. */
typedef struct {
    ${name}_real z[${NAME}_MEMORY_MAX];
} ${name}_memory;

/* Set the memory to its value at the start. */
void ${name}_start(${name}_memory *memory);

/* Write the inputs u of this sample and advance the memory to the next sample:
 * u = u0 + C z + D (y - y0), then z = A z + B (y - y0)$windup_comment. If the status is INVALID, u
 * is u0 within the limits, and z is unchanged.$sample_comment
 * Call once every sample time with the measured outputs y. The attitude in an output q_b is the
 * vector part of the quaternion relative to the reference, with scalar part >= 0.
 * The angle of a continuous joint may be given with any number of turns.
$output_list
$input_list
 */
int ${name}_step(${name}_memory *memory, ${sample_argument}const ${name}_real y[${NAME}_OUTPUTS],
                 ${name}_real u[${NAME}_INPUTS]);
