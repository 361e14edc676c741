#define ${NAME}_OUTPUTS $outputs

/* Write the moments u of the magnetorquers for the measured vectors y:
 * $formula
 * If the status is INVALID, u is zero.
$magnetic_list
$input_list
 */
int ${name}_step(const ${name}_real y[${NAME}_OUTPUTS], ${name}_real u[${NAME}_INPUTS]);
