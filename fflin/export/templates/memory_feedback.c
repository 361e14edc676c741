        for (i = 0; i < ${NAME}_INPUTS; i++) {
            int j;
            for (j = 0; j < ${NAME}_MEMORY; j++) {
                u[i] += C[i][j] * memory->z[j];
            }
        }
