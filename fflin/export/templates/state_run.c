static int run(const vector *given, ${name}_real out[$outs])
{
    ${name}_measured m = {{0}, {0}, {0}, {0}, {0}, {0}};
    const ${name}_real *in = given->in;
    int i;
$memory_run
    for (i = 0; i < 4; i++) {
        m.attitude[i] = *in++;
    }
    for (i = 0; i < 3; i++) {
        m.position[i] = *in++;
    }
    for (i = 0; i < ${NAME}_JOINTS; i++) {
        m.joints[i] = *in++;
    }
    for (i = 0; i < 3; i++) {
        m.angular_velocity[i] = *in++;
    }
    for (i = 0; i < 3; i++) {
        m.velocity[i] = *in++;
    }
    for (i = 0; i < ${NAME}_JOINTS; i++) {
        m.joint_rates[i] = *in++;
    }
    ${run_step}
}
